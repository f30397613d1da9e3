"""Speed against error: suites of photographs with known answers, and what is made of their runs."""
