"""The science: physics, estimators, leg filters, twins, health features and prognosis. Knows no pipeline."""
