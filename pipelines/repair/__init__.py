"""What of a home is damaged, and how it becomes whole again."""
