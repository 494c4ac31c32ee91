"""What is wrong with a pack, and how sure: residuals, features, detection, diagnosis, alerts."""
