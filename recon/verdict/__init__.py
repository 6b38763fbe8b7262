"""Whether a reconstruction can be trusted, judged from its data alone."""
