"""The decode loop and what it asks of targets and of the parts of a method. It knows no method."""
