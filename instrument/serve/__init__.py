"""A bench's devices for other computers: ``diffuserbench serve``, and its page in the browser."""
