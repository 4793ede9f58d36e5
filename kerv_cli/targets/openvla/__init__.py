"""Load published OpenVLA checkpoints as targets."""
