"""Copy recordings: whole chunks, merged, trimmed, rewritten or resumed."""
