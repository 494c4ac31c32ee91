"""Compute each flight's evidence of health: residuals, sensor checks, features, detection."""
