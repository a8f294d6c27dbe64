"""The controllers that come with Wavequake, one file each."""
