"""LED arrays that run the open Illuminate firmware (1.16 and later, 2.x), over USB serial."""
