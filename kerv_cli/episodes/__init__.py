"""One episode: its settings, policy and clock, and what determines its result."""
