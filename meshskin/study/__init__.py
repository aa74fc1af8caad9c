"""Parameter studies: many cases, on one machine or a cluster, that survive interruptions."""
