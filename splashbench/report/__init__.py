"""Results to leaderboard, charts and contact sheets. Everything is generated from results and never edited."""
