// Names of joints, "group.joint": arranged in groups, and shortened as far as they stay distinct.

import { t } from "../../site/sentences.js";

const LONG = 18; // characters that fit in a list

/** Split a full name into {group, joint}. */
export function splitName(full) {
  const dot = full.indexOf(".");
  return dot < 0 ? { group: "joints", joint: full } : { group: full.slice(0, dot), joint: full.slice(dot + 1) };
}

/**
 * Return short labels for the joints of one group: as few of each name's last words as distinguish all of them, without last
 * words that all share. A label begins with a letter, because "1" of "wrist_1_joint" says too little beside "pan" of
 * "shoulder_pan_joint".
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

/** Return the joints of one group [{joint, index}] with a short `label` each; a gripper is labelled as such. */
export function withLabels(joints, grippers) {
  const short = shortLabels(joints.filter(({ index }) => !grippers.includes(index)).map(({ joint }) => joint));
  return joints.map((one) => ({ ...one, label: grippers.includes(one.index) ? t("page.manual.gripper", "gripper") : short.shift() }));
}

/**
 * Return options with the values 0, 1, ... for full names, some of which are `grippers`. With several groups, each has a
 * heading, and long names are shortened to group and label.
 */
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
