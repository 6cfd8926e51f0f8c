"""The whole benchmark: methods on many scenes with an estimate before, and a public leaderboard in a folder."""
