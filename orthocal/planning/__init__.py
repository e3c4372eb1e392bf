"""Which readings to take: candidates, a choice among them, and what it will be worth."""
