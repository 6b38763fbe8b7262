"""The assembled bench: configuration, safety, acquisition, run store, command line."""
