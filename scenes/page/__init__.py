"""The demo's page: what it shows, who answers on it, and what is asked of it."""
