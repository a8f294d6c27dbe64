"""A study of eighteen segments that takes no time: random pistons at two instants."""

HEAD = """
[study]
name = "tiny"
workflow = "segment-disturbance"
[telescope]
name = "tmt-18"
"""
STUDY = (
    HEAD
    + """[imaging]
pixels = 16
[store]
chunk_cases = 4
[[disturbance]]
name = "pistons"
model = "static-random"
piston_nm = 20.0
instants = 2
"""
)
