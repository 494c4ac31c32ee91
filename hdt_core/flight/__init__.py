"""What was flown: phases, sample quality, steady state, and which legs are nominal."""
