"""Run the cases of a campaign and keep them: chunks, tasks, the journal, the store, its repair."""
