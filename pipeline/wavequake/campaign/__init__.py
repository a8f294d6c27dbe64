"""Campaigns: run the cases of any workflow, keep them, judge them. Knows no physics."""
