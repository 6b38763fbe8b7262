"""What GenICam cameras have in common, whichever library reaches them."""
