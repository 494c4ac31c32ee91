"""The page of cases and Dagster's page, each behind the same guard."""
