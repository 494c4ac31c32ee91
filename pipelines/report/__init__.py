"""The fleet's health as one offline HTML page, and pictures of a night for Dagster."""
