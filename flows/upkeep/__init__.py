"""Care for stores: what may go, what stays, repairs, copies, and what depends on what."""
