/* Which source this was compiled from: `fieldcal.compiled.load` compares. */
const char *fieldcal_source = FIELDCAL_SOURCE;
