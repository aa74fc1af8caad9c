"""The learned response: places and response together, contacts and forces with errors."""
