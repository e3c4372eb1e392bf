"""What reads a machine: each sensor in a file of its own, known to all others by its protocol."""
