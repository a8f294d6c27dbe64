"""Workflows of any optical system whose surfaces move and deform."""
