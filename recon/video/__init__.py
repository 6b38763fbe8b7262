"""Videos: frame by frame with warm starts, in blocks that do not depend on one another."""

from recon.video.solver import PRIORS, VideoCamera, VideoSolver, blocks_of, video_camera

__all__ = ["PRIORS", "VideoCamera", "VideoSolver", "blocks_of", "video_camera"]
