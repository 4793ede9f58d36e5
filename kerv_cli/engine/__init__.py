"""The decode loop, and the interfaces of targets and of a method's parts. No method is named here."""
