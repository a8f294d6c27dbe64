"""Controllers that were designed on a reduced model, judged on the full one: poles, margins, what is left."""
