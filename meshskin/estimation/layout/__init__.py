"""Layout of taxels from co-activation: which taxels answer together, without contact points."""
