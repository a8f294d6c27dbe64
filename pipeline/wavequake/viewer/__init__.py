"""One offline page that shows a store in motion: bodies in space, wavefront, image, line of sight."""
