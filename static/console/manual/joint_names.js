// Names of joints, "group.joint": in groups, and as short as still tells one from the other.

import { t } from "../../site/sentences.js";

const LONG = 18; // letters that a list has room for

/** {group, joint} of a full name. */
export function splitName(full) {
  const dot = full.indexOf(".");
  return dot < 0 ? { group: "joints", joint: full } : { group: full.slice(0, dot), joint: full.slice(dot + 1) };
}

/**
 * Short labels of the joints of one group: as few of a name's last words as tell all of them apart, without those
 * at the end that all share ("pan" of "shoulder_pan_joint" says too little where another is "1" of "wrist_1_joint").
 */
export function shortLabels(joints) {
  const words = joints.map((joint) => joint.split("_"));
  while (words.length > 1 && words.every((one) => one.length > 1 && one.at(-1) === words[0].at(-1))) words.forEach((one) => one.pop());
  const most = Math.max(...words.map((one) => one.length));
  for (let count = 1; count < most; count += 1) {
    const short = words.map((one) => one.slice(-count).join(" "));
    if (new Set(short).size === short.length && short.every((one) => /^[a-z]/i.test(one))) return short;
  }
  return words.map((one) => one.join(" "));
}

/** Joints of one group [{joint, index}] with a short `label` each; a gripper is called so. */
export function withLabels(joints, grippers) {
  const short = shortLabels(joints.filter(({ index }) => !grippers.includes(index)).map(({ joint }) => joint));
  return joints.map((one) => ({ ...one, label: grippers.includes(one.index) ? t("page.manual.gripper", "gripper") : short.shift() }));
}

/** Options of value 0, 1, ... for full names, `grippers` among them; several groups stand in the names and as headings. */
export function jointOptions(names, grippers = []) {
  const groups = new Map();
  names.forEach((full, index) => {
    const { group, joint } = splitName(full);
    if (!groups.has(group)) groups.set(group, []);
    groups.get(group).push({ full, joint, index });
  });
  const only = groups.size < 2;
  const parts = [...groups].map(([group, joints]) => {
    const options = withLabels(joints, grippers).map(({ full, label, index }) => {
      const text = full.length > LONG ? `${group}.${label}` : full;
      const option = new Option(only ? label : text, String(index));
      option.title = full;
      return option;
    });
    return only ? options : heading(group, options);
  });
  return parts.flat();
}

function heading(group, options) {
  const made = document.createElement("optgroup");
  made.label = group.replaceAll("_", " ");
  made.append(...options);
  return made;
}
