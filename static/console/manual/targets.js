// Targets of moving by hand: joints by group, within their limits, and the station's answers about them.

import { withLabels, splitName } from "./joint_names.js";
import { digitsOf, ENDLESS } from "../curves/units.js";
import { t } from "../../site/sentences.js";

/**
 * Return the joints of `facts` in groups, in order: [{name, joints: [{index, joint, label, full, lower, upper, unit,
 * gripper}]}].
 */
export function groupJoints({ joint_names: names = [], lower = [], upper = [], units = [], gripper_dims: grippers = [] }) {
  const found = new Map();
  names.forEach((full, index) => {
    const { group, joint: own } = splitName(full);
    if (!found.has(group)) found.set(group, []);
    const joint = { index, joint: own, full, unit: units[index] ?? "", gripper: grippers.includes(index) };
    found.get(group).push({ ...joint, lower: lower[index] ?? -ENDLESS, upper: upper[index] ?? ENDLESS });
  });
  return [...found].map(([name, joints]) => ({ name, joints: withLabels(joints, grippers) }));
}

/** Return the value within the joint's limits as {value, said}; `said` reports how it was limited, or is "". */
export function clampToLimits({ lower, upper, full, unit }, value) {
  const clipped = Math.min(upper, Math.max(lower, value));
  if (clipped === value) return { value, said: "" };
  return { value: clipped, said: t("page.manual.ends", "{joint} ends at {at}", { joint: full, at: clipped.toFixed(digitsOf({ lower, upper, unit })) }) };
}

/** Return the first target: where the robot is commanded or, if it is not engaged, measured; null if nothing is known. */
export function initialTarget({ measured, commanded, engaged } = {}) {
  const from = engaged && commanded ? commanded : measured;
  return from ? [...from] : null;
}

const VERY_NEAR = 0.005; // rad, or m of a gripper

/** Return whether the robot is at the target, by the station's distance. */
export function isAtTarget({ distance }) {
  return distance < VERY_NEAR;
}

/** Return the station's answer about a target as a sentence with its severity: {text, weight}. */
export function aimText({ ok, reason, distance, duration_s: seconds, reached, clipped = [], position_error_mm: mm, rotation_error_deg: deg }, speed) {
  if (!ok) return { text: reason || t("page.manual.unsaid", "the station did not say where that is"), weight: "warn" };
  if (reached === false) return { text: t("page.manual.unreachable", "Out of reach: the nearest is {mm} mm and {deg}° off.", { mm: mm.toFixed(0), deg: deg.toFixed(1) }), weight: "warn" };
  const limited = clipped.length ? t("page.manual.limited", " Limited: {joints}.", { joints: clipped.join(", ") }) : "";
  if (isAtTarget({ distance })) return { text: t("page.manual.there", "The robot is there, within {near} rad.{limited}", { near: VERY_NEAR, limited }), weight: limited ? "warn" : "" };
  return { text: t("page.manual.away", "{distance} rad from the robot, {seconds} s.{limited}", { distance: distance.toFixed(2), seconds: (seconds / speed).toFixed(1), limited }), weight: limited ? "warn" : "" };
}

/** Return the position [mm] of the end effector of arm number `index` from an answer's poses, in words; "" if there is none. */
export function tipPositionText(poses, index) {
  const at = poses?.slice(8 * index, 8 * index + 3) ?? [];
  if (at.length < 3) return "";
  return ["x", "y", "z"].map((axis, place) => `${axis} ${(1000 * at[place]).toFixed(0)}`).join("  ") + " mm";
}

/**
 * Return the arguments of a jog along or, with `turned`, about `axis` ("x", "y" or "z"): by `mm` or `degrees`, in the direction
 * `sign`.
 */
export function jogArguments({ arm, frame, axis, sign, turned, mm, degrees }) {
  const along = ["x", "y", "z"].map((one) => (one === axis ? sign : 0));
  const part = turned ? "rotation" : "translation";
  const size = turned ? (degrees * Math.PI) / 180 : mm / 1000;
  return { arm, frame, [part]: along.map((one) => one * size) };
}
