"""What a results folder holds, and what is imported into it."""
