// Why a ray is lost, as the host names it (wavequake/kernels/trace/status.py): one table for all traces.

enum { OK = 0, VIGNETTED = 1, MISS = 2, TOTAL_REFLECTION = 3, DIVERGED = 4, GAP = 5 };

// Of several reasons at one surface the one of the highest rank counts.
#define RANK(reason) \
    ((reason) == TOTAL_REFLECTION ? 1 : (reason) == VIGNETTED ? 2 : (reason) == DIVERGED ? 3 : (reason) == MISS ? 4 : 5)
#define RANKED (TOTAL_REFLECTION << 4 | VIGNETTED << 8 | DIVERGED << 12 | MISS << 16 | GAP << 20)

// Losses are numbers that fall from surface to surface, so that a ray keeps its largest: masks that are
// combined with one another cost processors without 512-bit vectors as much as the trace itself. 0: none.
#define LOSS(reason, surface) (8.0 * (255 - (surface)) + RANK(reason))

INLINE integers status_of(real loss) { return (integers)(RANKED) >> 4 * (to_integers(loss) & 7) & 15; }
INLINE integers surface_of(real loss) { return -1 - (to_integers(loss) >> 3); }
