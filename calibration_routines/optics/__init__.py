"""Angular response, DPC, beads, photographs."""
