"""What the report page is made of: its pictures and its template."""
