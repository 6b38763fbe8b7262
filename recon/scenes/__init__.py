"""Seeded test scenes with ground truth, not made with any reconstruction's forward model."""

from recon.scenes.scene import FAMILIES, SceneSpec, TestScene, make_scene, spec_of
from recon.scenes.score import Score, score

__all__ = ["FAMILIES", "SceneSpec", "Score", "TestScene", "make_scene", "score", "spec_of"]
