// Why a ray is lost, as the host names it (wavequake/kernels/trace/status.py): one table for all traces.

enum { OK = 0, VIGNETTED = 1, MISS = 2, TOTAL_REFLECTION = 3, DIVERGED = 4, GAP = 5, NO_ORDER = 6 };

// Of several reasons at one surface the one of the highest rank counts.
#define RANK(reason) \
    ((reason) == NO_ORDER           ? 1 \
     : (reason) == TOTAL_REFLECTION ? 2 \
     : (reason) == VIGNETTED        ? 3 \
     : (reason) == DIVERGED         ? 4 \
     : (reason) == MISS             ? 5 \
                                    : 6)
#define RANKED (NO_ORDER << 4 | TOTAL_REFLECTION << 8 | VIGNETTED << 12 | DIVERGED << 16 | MISS << 20 | GAP << 24)

// Losses are numbers that fall from surface to surface, so that a ray keeps its largest: masks that are
// combined with one another cost processors without 512-bit vectors as much as the trace itself. 0: none.
#define LOSS(reason, surface) (8.0 * (255 - (surface)) + RANK(reason))

INLINE integers status_of(real loss) { return (integers)(RANKED) >> 4 * (to_integers(loss) & 7) & 15; }
INLINE integers surface_of(real loss) { return -1 - (to_integers(loss) >> 3); }
