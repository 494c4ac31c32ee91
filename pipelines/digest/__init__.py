"""After the night: what changed since the last one, sent to the receivers of `notify.toml`, and work orders."""
