"""The evidence of a reading: `bounds` has the formulas, `ledger` the costs of choices, `detection` the results."""
