"""The sensors that come with Wavequake, one file each."""
