"""ASI controllers: MS-2000 and Tiger."""
