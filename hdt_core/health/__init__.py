"""What each flight says of health: residuals, sensor checks, features, detection."""
