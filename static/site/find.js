// The dialog Find (Ctrl+K or Cmd+K): one field that finds things of the lab by kind, and commands of this page.

import { get, RequestFailed } from "./api.js";
import { meaning, open, press, refusal } from "./keys.js";
import { t } from "./sentences.js";

const WAIT_MS = 90; // time to wait after each letter before the server is asked [ms]
const MOST = 8; // commands shown at most
// Controls that may be pressed from Find: none that moves a robot, and none that stops one.
const COMMANDS = [
  ...["view", "toggle", "open-panel", "lease", "how", "preflight-ask", "confirm-cameras"].map((name) => `[data-${name}]`),
  ...["record_start", "record_stop"].map((kind) => `[data-command="${kind}"]`),
  ...["open", "resume", "publish", "close"].map((what) => `[data-collect="${what}"]`),
  ...["#joint-next", "#curves-pause", "select", "summary", 'input:not([type="radio"], [type="checkbox"])'],
].map((each) => `${each}[data-key-text]`);

class Find {
  #dialog = document.getElementById("find");
  #words = document.getElementById("find-words");
  #list = document.getElementById("find-list");
  #said = document.getElementById("find-said");
  #options = [];
  #at = 0;
  #shown = ""; // the words whose results are in the list
  #asked = 0; // number of requests so far; an answer is ignored if a later request was sent
  #timer = 0;
  #hasty = null; // how Enter was pressed before the answer had come, else null

  constructor() {
    for (const button of document.querySelectorAll("[data-open-find]")) button.addEventListener("click", () => this.#open());
    window.addEventListener("keydown", (event) => this.#key(event));
    this.#words.addEventListener("input", () => this.#typed());
    this.#dialog.addEventListener("keydown", (event) => this.#within(event));
    this.#dialog.addEventListener("click", (event) => event.target === this.#dialog && this.#dialog.close());
    this.#dialog.addEventListener("close", () => this.#dialog.open || this.#forget()); // "close" is sent late: the dialog may be open again
    this.#list.addEventListener("click", (event) => this.#clicked(event));
  }

  #key(event) {
    if (event.altKey || event.shiftKey || !(event.ctrlKey || event.metaKey) || event.key.toLowerCase() !== "k") return;
    event.preventDefault(); // prevents the browser's own search as well
    if (this.#dialog.open) this.#dialog.close();
    else if (!document.querySelector("dialog:modal")) this.#open();
  }

  #open() {
    if (this.#dialog.open) return;
    this.#forget();
    open(this.#dialog);
    this.#words.focus();
    this.#words.select();
    if (!this.#words.value) this.#draw("", []);
  }

  /** Drop a pending request and its answer, and blur the field so that the next key goes to the page. */
  #forget() {
    clearTimeout(this.#timer);
    this.#hasty = null;
    this.#asked += 1;
    this.#words.blur();
  }

  #typed() {
    clearTimeout(this.#timer);
    this.#hasty = null;
    const words = this.#now();
    if (words) this.#timer = setTimeout(() => this.#ask(words), WAIT_MS);
    else this.#draw("", []);
  }

  #now() {
    return this.#words.value.trim().replace(/\s+/g, " ");
  }

  async #ask(words) {
    const turn = (this.#asked += 1);
    this.#said.textContent = t("page.find.looking", "Looking …");
    try {
      const { groups } = await get(`${this.#dialog.dataset.address}?q=${encodeURIComponent(words)}`);
      if (turn === this.#asked && words === this.#now()) this.#draw(words, groups);
    } catch (error) {
      if (!(error instanceof RequestFailed)) throw error;
      if (turn !== this.#asked) return;
      this.#draw(words, []);
      this.#said.textContent = error.message;
    }
  }

  // --- the list --------------------------------------------------------------------------------------------

  #draw(words, groups) {
    if (!words) this.#asked += 1; // answers under way are for words that were deleted
    this.#shown = words;
    const commands = commandsFor(words);
    const all = groups.map(({ name, items, more }) => ({ name, more, options: items.map(link) }));
    if (commands.length) all.push({ name: t("page.find.on_this_page", "On this page"), more: commands.length > MOST, options: commands.slice(0, MOST).map(button) });
    const found = all.reduce((count, { options }) => count + options.length, 0);
    if (words) all.push({ name: t("page.find.replay", "Replay"), more: false, options: [link(this.#inReplay(words))] });
    this.#list.replaceChildren(...all.map(section));
    this.#options = all.flatMap(({ options }) => options);
    this.#options.forEach((option, index) => (option.id = `find-${index}`));
    this.#choose(0);
    this.#said.textContent = saidOf(words, found);
    if (this.#hasty && words) this.#enter(this.#hasty);
  }

  #inReplay(words) {
    const address = `${this.#dialog.dataset.replay}?words=${encodeURIComponent(words)}`;
    return { title: t("page.find.episodes_with", "Episodes with “{words}”", { words }), detail: t("page.find.in_replay", "in task, scene, checkpoint, operator"), address };
  }

  #choose(index) {
    this.#options[this.#at]?.setAttribute("aria-selected", "false");
    this.#at = index;
    const chosen = this.#options[index];
    this.#words.setAttribute("aria-activedescendant", chosen?.id ?? "");
    chosen?.setAttribute("aria-selected", "true");
    chosen?.scrollIntoView({ block: "nearest" });
  }

  #within(event) {
    const count = this.#options.length;
    const step = { ArrowDown: 1, ArrowUp: -1 }[event.key];
    if (step && count) {
      event.preventDefault();
      this.#choose((this.#at + step + count) % count);
    } else if (event.key === "Enter" && !event.isComposing) {
      event.preventDefault();
      this.#enter({ apart: event.ctrlKey || event.metaKey });
    } else return;
    event.stopPropagation(); // the key must not act on the page
  }

  #enter(how) {
    const words = this.#now();
    if (words && words !== this.#shown) {
      this.#hasty = how; // pressed as soon as the answer has come
      return;
    }
    this.#hasty = null;
    const chosen = this.#options[this.#at];
    if (chosen instanceof HTMLAnchorElement && how.apart) window.open(chosen.href, "_blank", "noopener");
    else chosen?.click();
  }

  #clicked(event) {
    const option = event.target.closest("[role=option]");
    if (!option || event.ctrlKey || event.metaKey) return; // opens a new tab, so this one stays as it is
    this.#dialog.close();
    if (option.presses) press(option.presses);
  }
}

/** Return the controls of this page whose meaning, as the list of keys (`?`) gives it, contains all words of `query`. */
function commandsFor(query) {
  const words = query.toLowerCase().split(" ");
  const all = [...document.querySelectorAll(COMMANDS.join())].filter((element) => element.checkVisibility());
  return all.filter((element) => words.every((word) => meaning(element).toLowerCase().includes(word)));
}

function saidOf(words, count) {
  if (!words) return t("page.find.type", "Type a number, a code, or the start of a name.");
  return count ? t("page.find.found", "{count} found", { count }) : t("page.find.nothing", "Nothing found for “{words}”.", { words });
}

function section({ name, more, options }, index) {
  const group = document.createElement("div");
  group.setAttribute("role", "group");
  const head = Object.assign(document.createElement("div"), { className: "small muted find-kind", id: `find-kind-${index}` });
  head.setAttribute("role", "presentation"); // a listbox may only contain options and groups
  head.textContent = more ? t("page.find.more", "{name} · more match: type more", { name }) : name;
  group.setAttribute("aria-labelledby", head.id);
  group.append(head, ...options);
  return group;
}

function option(element, title, detail) {
  Object.assign(element, { className: "find-option", tabIndex: -1 });
  element.setAttribute("role", "option");
  element.setAttribute("aria-selected", "false");
  element.append(title);
  if (detail) element.append(Object.assign(document.createElement("span"), { className: "small muted", textContent: detail }));
  return element;
}

function link({ title, detail, address }) {
  const element = option(document.createElement("a"), title, detail);
  element.href = address;
  return element;
}

function button(control) {
  const element = option(document.createElement("button"), meaning(control), refusal(control));
  element.type = "button";
  element.presses = control; // pressing the control itself keeps its lease check, its gate and its refusal
  return element;
}

if (document.getElementById("find")) new Find();
