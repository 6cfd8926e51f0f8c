"""The leaderboard as one HTML page: standings over time, charts, and a table that sorts and filters."""

from splashbench.report.page.page import PAGE, leaderboard_page

__all__ = ["PAGE", "leaderboard_page"]
