// Rows of an image of PIXELS points, of which QUARTER = (PIXELS + 1) / 2 lie right of the middle, by vectors.

// Store W pixels of a row right of its middle, or left of it.
INLINE void put(real value, __global scalar *row, int u, int plus)
{
#if W > 1
    if (u + W > QUARTER) {
        for (int i = 0; u + i < QUARTER; ++i)
            row[plus ? PIXELS / 2 + u + i : (PIXELS - 1) / 2 - u - i] = LANE(value, i);
        return;
    }
#endif
    if (plus)
        STORE(value, row + PIXELS / 2 + u);
    else
        STORE(REVERSED(value), row + (PIXELS - 1) / 2 - u - (W - 1));
}
