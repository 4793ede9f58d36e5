"""Lists the contents of a results folder, and compares what it holds."""
