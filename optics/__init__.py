"""The storage device as physics: profile, page, waves, cameras, simulator, recording, registration. No torch here."""
