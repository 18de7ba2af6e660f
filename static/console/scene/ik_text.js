// How well the poses of a chunk were reached, in words.

import { t } from "../../site/sentences.js";

/** Format a number; one that would round to 0 is shown as "below" the smallest shown value. */
function small(value, digits) {
  const least = 10 ** -digits;
  return value > 0 && value < least ? t("page.reach.below", "below {least}", { least: least.toFixed(digits) }) : value.toFixed(digits);
}

/**
 * Describe `ik` of the station (rows, over, limit, velocity, singular, worst_mm, worst_deg) in words; "" if the chunk has no
 * poses.
 */
export function ikText({ rows = 0, over = 0, limit = 0, velocity = 0, singular = 0, worst_mm: mm, worst_deg: deg } = {}) {
  if (!rows) return "";
  const known = Number.isFinite(mm) && Number.isFinite(deg);
  const worst = known ? t("page.reach.worst", ", worst {mm} mm and {deg}°", { mm: small(mm, over ? 1 : 3), deg: small(deg, over ? 1 : 3) }) : "";
  const met = over ? t("page.reach.unmet", "{over} of {rows} poses not reached", { over, rows }) : t("page.reach.met", "{rows} poses reached", { rows });
  const flags = [[limit, t("page.reach.limit", "at a joint limit")], [velocity, t("page.reach.velocity", "as fast as joints may")], [singular, t("page.reach.singular", "near singular")]];
  const said = flags.filter(([count]) => count).map(([count, words]) => t("page.reach.flag", "{count} {words}", { count, words }));
  return [met + worst, ...said].join(t("page.common.semicolon", "; "));
}
