"""The data of an estimate: readings beside their contacts, units, resolved beliefs."""
