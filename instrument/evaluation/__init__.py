"""Charts, analyses and stability maps as files and figures."""
