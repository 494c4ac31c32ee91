"""The shared homes of the house's own tests."""

from tests.conftest import own_home, sample_home, sample_landing

__all__ = ["own_home", "sample_home", "sample_landing"]
