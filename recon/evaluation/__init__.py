"""Scenes with known truth, charts of error against cost, stability maps."""
