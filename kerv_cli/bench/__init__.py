"""How far a target's forwards are from what the device can do, and recorded decodes executed on other shapes."""
