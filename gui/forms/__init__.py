"""What the forms ask for: fields with units and reasons, and the procedures that they make; no widgets."""
