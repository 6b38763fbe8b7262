# What `import recon.blind` offers: each name with its home, from which `__init__.py` imports it.

from recon.blind.alternate import BlindResult as BlindResult
from recon.blind.alternate import calibrate_from_beads as calibrate_from_beads
from recon.blind.known_pictures import PicturePsf as PicturePsf
from recon.blind.known_pictures import PictureSettings as PictureSettings
from recon.blind.known_pictures import psf_from_pictures as psf_from_pictures
from recon.blind.settings import BlindSettings as BlindSettings
from recon.camera.points import Points as Points
