"""What several drivers share: streams, pixels, serial lines, polled stages."""
