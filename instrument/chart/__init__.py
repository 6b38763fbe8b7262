"""Charts of cost against accuracy: run, kept, drawn, read back."""
