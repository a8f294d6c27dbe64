"""Model order reduction: every method of Störkle 2018, Table 2.1, and measures of what it costs."""
