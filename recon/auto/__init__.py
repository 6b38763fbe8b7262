"""The smallest model that explains the data: what to reconstruct with, why, and what another would cost."""

from recon.auto.choice import Choice, Decision, Option
from recon.auto.decide import choose
from recon.auto.picture import choose_picture
from recon.auto.wishes import Wishes

__all__ = ["Choice", "Decision", "Option", "Wishes", "choose", "choose_picture"]
