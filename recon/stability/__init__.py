"""Where methods fail: what counts as failure, cameras and scenes under stress, and maps of the boundary."""
