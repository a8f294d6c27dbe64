"""OpenCL host code and the NumPy twins of the kernels; packed arrays only."""
