"""Short hashes of what something is made of."""

import hashlib


def digest(*parts: str) -> str:
    """Short stable hash of some strings."""
    return hashlib.blake2b("\x1f".join(parts).encode(), digest_size=10).hexdigest()
