"""Short hashes of what something is made of, and of what a file holds."""

import hashlib


def digest(*parts: str) -> str:
    """Short stable hash of some strings."""
    return hashlib.blake2b("\x1f".join(parts).encode(), digest_size=10).hexdigest()


def hash_of(content: bytes) -> str:
    """What names a file by its content: 20 digits of SHA-256."""
    return hashlib.sha256(content).hexdigest()[:20]
