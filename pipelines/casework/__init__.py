"""Cases: who works on which alert, until when it is muted, and what an inspection found."""
