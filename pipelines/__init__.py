"""From a landing zone to a catalog: Dagster assets over `hdt_core`, storage, and the `hdt` command."""
