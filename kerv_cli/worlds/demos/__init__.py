"""Record demonstrations, store them, and read them back."""
