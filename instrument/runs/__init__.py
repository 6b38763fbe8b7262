"""Plans carried out, and the folders that hold what was taken."""
