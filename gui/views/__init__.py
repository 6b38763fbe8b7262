"""Widgets that show results: pictures, volumes, holograms, charts. They know no bench."""
