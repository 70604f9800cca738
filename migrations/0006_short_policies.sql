-- The steps of the policy in short (postcard), which together with the summary are all of it. NULL: `policy` has the whole. Else that
-- is empty.
ALTER TABLE policies ADD COLUMN steps BLOB;
