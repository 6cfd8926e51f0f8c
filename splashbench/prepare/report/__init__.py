"""prepare_report.html, the page that tells how a preparation went."""
