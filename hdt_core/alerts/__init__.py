"""What is wrong with a pack, and how sure: faults isolated, cases opened and closed, evidence in words."""
