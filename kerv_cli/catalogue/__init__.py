"""Lists the contents of a results folder, runs stored studies again, and imports studies from elsewhere."""
