"""Published OpenVLA checkpoints as targets."""
