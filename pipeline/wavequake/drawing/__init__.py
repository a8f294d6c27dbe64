"""Pictures of what is computed: optical systems with their rays, segmented mirrors, finite-element mirrors.

Geometry first (`layout`, `solid`), as arrays that tests compare with the trace, then strokes (`section`,
`aperture`, `model`, `still`).
"""
