"""What people do about alerts: who has which case in hand, until when it is muted, what was found."""
