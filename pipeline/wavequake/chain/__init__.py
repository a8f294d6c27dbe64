"""What a study is put together from: each part beside its section of the study file."""
