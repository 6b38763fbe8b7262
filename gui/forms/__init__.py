"""Declared options on the screen: a field each, one form for all, and the form of a reconstruction."""
