"""Live view and live reconstruction of a camera's frames."""
