"""Ray traces through segmented telescopes and any sequence of surfaces, with their NumPy twins."""
