"""Which drivers there are, what is connected, and who has it."""
