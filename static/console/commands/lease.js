// Who commands: taken, renewed each second, requested, handed over, given up. A page that is hidden says so: it keeps the
// station while nothing moves and nobody else asks; a run that goes on is held, after a countdown with tones.

import { post } from "../../site/api.js";
import { clockTime } from "../../site/times.js";
import { config } from "../live/config.js";
import { t } from "../../site/sentences.js";

const NAMES = {
  claim: t("page.lease.claim", "Take the station"),
  give_up: t("page.lease.give_up", "Give up"),
  request: t("page.lease.request", "Ask for the station"),
  withdraw: t("page.lease.withdraw", "Withdraw"),
  hand_over: t("page.lease.hand_over", "Hand over"),
  decline: t("page.lease.decline", "Decline"),
  move: t("page.lease.move", "Take it here"),
};

const GIVEN_AWAY = ["give_up", "hand_over"];
const WHY = {
  elsewhere: t("page.lease.why_elsewhere", "you took the station on another page"),
  other: "",
  free: t("page.lease.why_free", "the lease was ended by the station"),
};

export class LeaseControls {
  #store;
  #socket;
  #commands;
  #hiddenAt = 0;
  #yields = false; // somebody asks for the station while nobody sees this page
  #away = ""; // what to say if the lease has ended while this page was hidden; not known yet
  #tones = null;
  #title = document.title;
  #awake = null;
  #refused = 0;
  #before = "unknown";
  #mine = false; // this page has commanded, and nothing was heard yet of who does since
  #heardAt = 0; // when its lease was last renewed

  constructor(store, socket, commands) {
    this.#store = store;
    this.#socket = socket;
    this.#commands = commands;
    store.on(["snapshot", "link", "open"], () => this.#draw());
    store.on("renewed", (answer) => this.#renewed(answer));
    store.on("changed", (what) => what.includes("lease") && this.#changed());
    document.body.addEventListener("htmx:afterSettle", () => this.#draw());
    document.addEventListener("click", (event) => this.#clicked(event));
    document.addEventListener("submit", (event) => this.#taken(event));
    document.addEventListener("visibilitychange", () => this.#visibility());
    window.addEventListener("beforeunload", (event) => this.#leaving(event));
    new Worker(config.beat).addEventListener("message", () => this.#beat());
    this.#draw();
  }

  /** The server answered a renewal; the station's own state says the rest. */
  #renewed({ ok, reason }) {
    this.#refused = ok || this.#store.lease !== "mine" ? 0 : this.#refused + 1;
    if (ok) {
      this.#away = "";
      this.#heardAt = performance.now();
    }
    if (this.#refused > 1) this.#commands.say(t("page.lease.not_renewed", "Lease not renewed: {reason}", { reason }), "refused"); // once: it was just handed over
  }

  #draw() {
    const lease = this.#store.fresh ? this.#store.lease : "unknown";
    for (const part of document.querySelectorAll("[data-lease-when]")) part.hidden = part.dataset.leaseWhen !== lease;
    for (const name of document.querySelectorAll("[data-lease-holder]")) {
      name.textContent = this.#store.commander;
    }
    document.body.dataset.lease = lease;
    if (!["mine", "unknown"].includes(lease)) this.#ended(lease);
    if (lease === this.#before) return;
    if (lease === "mine") {
      this.#mine = true;
      this.#heardAt = performance.now();
      this.#stayAwake();
    }
    if (this.#before === "mine") this.#letSleep();
    this.#before = lease;
  }

  #beat() {
    if (document.hidden) this.#countDown();
    this.#renew();
  }

  /** The runtime takes that of a hidden page only while nothing moves. */
  #renew() {
    if (this.#store.lease !== "mine" || (document.hidden && this.#yields)) return;
    this.#socket.send({ type: "renew", epoch: this.#store.epoch, ...(document.hidden && { hidden: true }) });
  }

  #changed() {
    this.#yields ||= document.hidden;
    window.htmx.trigger("#lease", "eva:lease");
  }

  /** How long until a run is held, in the tab's title, with a tone each second. */
  #countDown() {
    const { facts, state_is } = this.#store.snapshot;
    const left = Math.ceil(facts.lease_ttl_s - (performance.now() - this.#hiddenAt) / 1000);
    if (!this.#hiddenAt || !state_is.moving || left < -1) return;
    document.title = left > 0 ? t("page.lease.come_back", "COME BACK: holds in {left} s", { left }) : t("page.lease.held", "the robot is held");
    if (left > 0) this.#tone();
  }

  #tone() {
    this.#tones ??= new AudioContext();
    const tone = new OscillatorNode(this.#tones, { frequency: 880 });
    tone.connect(this.#tones.destination);
    tone.start();
    tone.stop(this.#tones.currentTime + 0.15);
  }

  async #clicked(event) {
    const button = event.target.closest("[data-lease][type='button']");
    if (!button) return;
    const content = button.dataset.request ? { request: Number(button.dataset.request) } : {};
    await this.#act(button.dataset.lease, NAMES[button.dataset.lease], content);
  }

  async #taken(event) {
    const form = event.target.closest("[data-lease-take]");
    if (!form) return;
    event.preventDefault();
    const done = await this.#act("take", t("page.lease.take_over", "Take over"), { reason: form.elements.reason.value });
    if (done) form.dispatchEvent(new Event("eva:saved", { bubbles: true }));
  }

  async #act(action, name, content) {
    this.#commands.say(t("page.common.pressed", "{name}: pressed …", { name }), "pressed");
    const mine = this.#mine;
    if (GIVEN_AWAY.includes(action)) this.#mine = false; // what is given up is not lost
    try {
      await post(config.api.lease, { action, page: this.#store.page, ...content });
      this.#commands.say(t("page.common.done", "{name}: done", { name }), "accepted");
      return true;
    } catch (error) {
      this.#mine = mine;
      this.#commands.fail(name, error);
      return false;
    } finally {
      window.htmx.trigger("#lease", "eva:lease");
    }
  }

  /** A page nobody sees commands no robot that moves: said beforehand on the page, and here in the tab's title. */
  #visibility() {
    if (document.hidden) {
      if (this.#store.lease !== "mine") return;
      this.#hiddenAt = performance.now();
      this.#beat();
      return;
    }
    if (!this.#hiddenAt) return;
    const away = (performance.now() - this.#hiddenAt) / 1000;
    const held = this.#yields || document.title !== this.#title;
    if (held) this.#away = t("page.lease.hidden", "This page was hidden for {seconds} s: its lease has ended, and a run in progress is held.", { seconds: away.toFixed(0) });
    this.#hiddenAt = 0;
    this.#yields = false;
    document.title = this.#title;
    this.#stayAwake();
    this.#renew();
    this.#draw();
  }

  /** This page commands no more: said here, with since when and why, but where it gave the station away itself. */
  #ended(lease) {
    if (this.#mine || this.#away) this.#commands.say(this.#away || this.#lost(lease), "refused");
    this.#mine = false;
    this.#away = "";
  }

  #lost(lease) {
    const silent = (performance.now() - this.#heardAt) / 1000;
    const expired = silent > 0.8 * this.#store.snapshot.facts.lease_ttl_s;
    const why = expired ? t("page.lease.unheard", "your page was not heard for {seconds} s", { seconds: silent.toFixed(0) }) : WHY[lease];
    const taken = lease === "other" ? t("page.lease.taken", "{who} commands", { who: this.#store.commander }) : "";
    const at = clockTime(Date.now());
    const because = [why, taken].filter(Boolean).join(t("page.common.semicolon", "; "));
    return t("page.lease.lost", "You do not command any more, since {at}: {because}.", { at, because });
  }

  #leaving(event) {
    if (this.#store.lease === "mine" && this.#store.snapshot.state_is.going) event.preventDefault();
  }

  /** A tablet that darkens its screen would hide the page. */
  async #stayAwake() {
    if (!("wakeLock" in navigator) || document.hidden) return;
    try {
      this.#awake = await navigator.wakeLock.request("screen");
    } catch (error) {
      console.info(`the screen may turn off by itself: ${error.message}`);
    }
  }

  #letSleep() {
    this.#awake?.release();
    this.#awake = null;
  }
}
