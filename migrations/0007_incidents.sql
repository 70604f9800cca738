-- What keeps the service whole when its disk, its clock or its file is not what it was.

-- "etud": says whose the file is.
PRAGMA application_id = 1702131044;

-- When the service was last known to be alive, so that time in which it was not does not count. At most one row.
CREATE TABLE service (
    id             INTEGER NOT NULL PRIMARY KEY CHECK (id = 1),
    last_alive_ms  INTEGER NOT NULL -- since 1970, UTC
) STRICT;

-- CRC-32 of the summary (high half) and of the steps or the whole policy (low half), as they were written. NULL: written before
-- there were any.
ALTER TABLE policies ADD COLUMN checksum INTEGER;

-- The id of the refined policy. Of policies that were refined before, their texts have it.
ALTER TABLE policies ADD COLUMN refined_by TEXT;

-- How often it was taken up. What has ended the process each time is given up.
ALTER TABLE refinements ADD COLUMN attempts INTEGER NOT NULL DEFAULT 0;

-- Whether there are rewards that no version of the weights has folded in.
ALTER TABLE learners ADD COLUMN has_pending INTEGER NOT NULL DEFAULT 0;

UPDATE learners SET has_pending = 1
WHERE (SELECT MAX(reward_order) FROM rewards r WHERE r.learner = learners.sequence)
    > (SELECT MAX(reward_order) FROM weights w WHERE w.learner = learners.sequence);

CREATE INDEX learners_with_pending ON learners (sequence) WHERE has_pending = 1;
