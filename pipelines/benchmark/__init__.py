"""What `hdt benchmark` measures: this installation against named peers."""
