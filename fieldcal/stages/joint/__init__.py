"""The joint estimate of a flight: by the VPS where there is one, else by vectors; judged, and written as rows."""
