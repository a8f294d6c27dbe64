"""The store of a campaign: arrays, journal, retention, status and verification."""
