"""A finished model in the formats of other runtimes; each module checks its file in the runtime it is for."""
