"""For notebooks and scripts, through ``import diffuserbench``: results that show and save themselves."""
