"""The actuators that come with Wavequake, one file each."""
