"""From traced rays to wavefronts: fits, slopes, reference spheres, quality."""
