"""The `kerv` command: one file per command. Each file parses, calls one function of a lower layer, and prints."""
