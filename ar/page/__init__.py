"""The page in the browser: its parts, its visitors, what they may say to it."""
