"""Fresh loops: a stand-in that shares no observables with any candidate, and runs that took no part in a choice."""
