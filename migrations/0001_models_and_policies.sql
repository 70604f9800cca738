-- Models, by the name that a client gave them. `definition` is the canonical text that `hash` (SHA-256) is of.
CREATE TABLE models (
    name           TEXT    NOT NULL PRIMARY KEY,
    hash           TEXT    NOT NULL,
    definition     TEXT    NOT NULL,
    attributes     TEXT    NOT NULL, -- JSON
    actions        TEXT    NOT NULL, -- JSON
    n_states       INTEGER NOT NULL,
    n_transitions  INTEGER NOT NULL,
    n_unsafe       INTEGER NOT NULL,
    created_at_ms  INTEGER NOT NULL  -- since 1970, UTC
) STRICT;

-- Policies, in the order in which they became durable. A policy outlives its model.
CREATE TABLE policies (
    sequence       INTEGER NOT NULL PRIMARY KEY AUTOINCREMENT,
    id             TEXT    NOT NULL UNIQUE,
    summary        TEXT    NOT NULL, -- JSON: the policy without its steps
    policy         TEXT    NOT NULL, -- JSON: the policy as it was answered
    created_at_ms  INTEGER NOT NULL
) STRICT;
