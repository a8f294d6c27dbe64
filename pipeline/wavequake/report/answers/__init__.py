"""What single commands print and draw: budgets, comparisons, tails, sensitivities."""
