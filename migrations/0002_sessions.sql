-- Streams. Of a session, what it was opened with and the observations are kept; all else follows from them.
CREATE TABLE sessions (
    sequence        INTEGER NOT NULL PRIMARY KEY AUTOINCREMENT,
    id              TEXT    NOT NULL UNIQUE,
    model           TEXT    NOT NULL,
    model_hash      TEXT    NOT NULL,
    weights         TEXT    NOT NULL, -- JSON: one number per attribute, in the model's order
    lookahead       INTEGER,          -- NULL: only proven steps are committed before the end
    start           INTEGER,          -- state index; NULL: the model's
    learner         TEXT,             -- whose weights are used, if any
    weights_version INTEGER,          -- of that learner
    trial_id        TEXT,             -- the trial that is explored, if any
    status          TEXT    NOT NULL CHECK (status IN ('open', 'done', 'expired')),
    n_observations  INTEGER NOT NULL,
    policy_id       TEXT,
    created_at_ms   INTEGER NOT NULL,
    active_at_ms    INTEGER NOT NULL
) STRICT;

CREATE INDEX sessions_by_activity ON sessions (active_at_ms) WHERE status = 'open';

-- Observations as they came, several a row. `states` is a JSON array of `n_states` states, the first of which is the
-- observation `seq`.
CREATE TABLE observations (
    session_id  TEXT    NOT NULL,
    seq         INTEGER NOT NULL,
    n_states    INTEGER NOT NULL,
    states      TEXT    NOT NULL,
    PRIMARY KEY (session_id, seq)
) STRICT, WITHOUT ROWID;

-- Policies that a finite lookahead decided and that wait to be refined to the global optimum.
CREATE TABLE refinements (
    policy_id   TEXT    NOT NULL PRIMARY KEY,
    model_hash  TEXT    NOT NULL,
    request     TEXT    NOT NULL  -- JSON: the request for the refined policy
) STRICT;
