// The page: one episode at one step, and everything that shows it.

const PLACES = [
  "tree", "variation", "board", "transport", "timeline", "hint", "announcer", "reasons", "charts", "inputs",
  "more-inputs",
];
const KINDS = { trained: "training", validation: "validation, not trained on", unseen: "unseen in training" };
const MOST_FIELDS = 200; // more would take the browser seconds
const QUESTION =
  "Set the inputs: the program answers at once. A step forward keeps the answer and asks again; the program " +
  "remembers what it has read.";

class Page {
  constructor(data) {
    this.data = data;
    this.policy = new ProgramPolicy();
    this.program = this.policy.program;
    this.place = Object.fromEntries(PLACES.map((id) => [id, document.getElementById(id)]));
    this.selected = null;
    this.tree = new ProgramView(this.place.tree, this.program, data.importance, data.grids);
    this.reasons = new ReasonsView(this.place.reasons, this.policy);
    this.charts = new ChartsView(this.place.timeline, this.place.charts, this.program, (t) => this.seek(t));
    this.inputs = new InputsView(this.place.inputs, this.place["more-inputs"], this.program.inputNames);
    this.makeTransport();
    this.start(new URLSearchParams(location.hash.slice(1)));
    document.addEventListener("keydown", (event) => this.press(event));
  }

  // wish: what the address asks for, as in page.html#episode=3&step=10
  start(wish) {
    const last = this.data.episodes.length - 1;
    if (last >= 0) {
      this.makeVariations(last);
      this.open(Math.min(wholeNumber(wish.get("episode"), this.firstEpisode()), last));
    } else {
      this.makeQuestion();
      this.ask([new Array(this.program.nObservations).fill(0)], 0);
    }
    this.seek(wholeNumber(wish.get("step"), 0));
  }

  // The largest training variation: long enough to be worth a look.
  firstEpisode() {
    return Math.max(0, this.data.episodes.findLastIndex(({ kind }) => kind === "trained"));
  }

  open(index) {
    const episode = this.data.episodes[index];
    const world = WORLDS[this.data.world];
    Object.assign(this, { index, episode, edited: false, selected: null, scene: null });
    this.frames = world
      ? simulate(this.policy, new world(episode.start), this.data.cap, episode.actions)
      : replay(this.policy, episode);
    if (episode.scene) this.scene = readScene(episode);
    this.begin(0);
  }

  // Let the program act from a state that the reader has made.
  edit(state) {
    Object.assign(this, { edited: true, selected: null });
    this.frames = simulate(this.policy, new WORLDS[this.data.world](state), this.data.cap);
    this.begin(0);
    this.announce(`Your state. ${this.ending()}`);
  }

  // Answer inputs that the reader has set.
  ask(observations, t) {
    this.observations = observations;
    this.frames = answer(this.policy, observations);
    this.begin(t);
  }

  begin(t) {
    this.stop();
    this.charts.build(this.frames);
    this.scrubber.max = this.frames.length - 1;
    this.showVariation();
    this.seek(t);
  }

  seek(t) {
    this.t = Math.max(0, Math.min(this.frames.length - 1, t));
    this.show();
  }

  step(by) {
    this.stop();
    this.selected = null;
    const asked = this.question && by > 0 && this.t === this.frames.length - 1;
    if (asked) this.ask([...this.observations, this.observations[this.t]], this.t + 1);
    else this.seek(this.t + by);
    this.announce(this.status.textContent);
  }

  play() {
    if (this.timer) return this.stop();
    if (this.t === this.frames.length - 1) this.seek(0);
    const pause = Math.max(60, Math.min(700, 12000 / this.frames.length));
    this.timer = setInterval(() => {
      this.seek(this.t + 1);
      if (this.t === this.frames.length - 1) this.stop();
    }, pause);
    this.showPlaying();
    return undefined;
  }

  stop() {
    clearInterval(this.timer);
    this.timer = null;
    this.showPlaying();
  }

  press(event) {
    if (event.altKey || event.ctrlKey || event.metaKey) return;
    const pressed = event.target.closest("button, summary, [role=button]");
    if (event.target.matches("input") || (pressed && (event.key === " " || event.key === "Enter"))) return;
    const actions = {
      ArrowRight: () => this.step(1),
      ArrowLeft: () => this.step(-1),
      " ": () => this.play(),
      Home: () => this.step(-this.t),
      End: () => this.step(this.frames.length - 1 - this.t),
    };
    if (!actions[event.key]) return;
    event.preventDefault();
    actions[event.key]();
  }

  announce(text) {
    this.place.announcer.textContent = text;
  }

  makeTransport() {
    const button = (label, sign, press) =>
      make("button", { type: "button", "aria-label": label, title: label, onclick: press }, icon(sign));
    const first = button("First step", "first", () => this.step(-this.t));
    const back = button("Step back", "back", () => this.step(-1));
    this.player = button("Play", "play", () => this.play());
    this.player.classList.add("player");
    const forward = button("Step forward", "forward", () => this.step(1));
    this.scrubber = make("input", { type: "range", min: 0, value: 0, "aria-label": "Step" });
    this.scrubber.addEventListener("input", () => {
      this.stop();
      this.seek(Number(this.scrubber.value));
    });
    this.status = make("p", { class: "status" });
    const controls = make("div", { class: "controls" }, first, back, this.player, forward, this.scrubber);
    this.place.transport.append(controls, this.status);
  }

  makeVariations(last) {
    this.slider = make("input", { type: "range", min: 0, max: last, "aria-label": "Variation" });
    this.slider.addEventListener("input", () => this.open(Number(this.slider.value)));
    const marks = this.data.episodes.map(({ kind }) => make("i", { class: kind }));
    this.label = make("p", { class: "variation-label" });
    this.place.variation.append(this.label);
    if (last > 0) {
      const track = make("div", { class: "marks", "aria-hidden": "true" }, marks);
      this.place.variation.append(make("div", { class: "slider" }, this.slider, track));
    }
    if (BOARDS[this.data.world]) this.hint(BOARDS[this.data.world].hint);
  }

  makeQuestion() {
    this.player.hidden = true;
    const [total, shown] = [this.program.nObservations, Math.min(this.program.nObservations, MOST_FIELDS)];
    this.hint(total > shown ? `${QUESTION} These are the first ${shown} of ${total}; the others stay 0.` : QUESTION);
    const names = this.program.inputNames.slice(0, shown);
    this.question = new QuestionView(this.place.board, names, (index, value) => {
      const observations = this.observations.slice(0, this.t + 1);
      observations[this.t] = observations[this.t].map((old, i) => (i === index ? value : old));
      this.ask(observations, this.t);
    });
  }

  hint(text) {
    this.place.hint.textContent = text;
    this.place.hint.hidden = false;
  }

  showVariation() {
    if (this.question) return;
    const words = this.edited ? "Your state" : variationWords(this.episode.variation, this.data.size);
    const kind = KINDS[this.episode.kind];
    const back = { type: "button", class: "quiet", onclick: () => this.open(this.index) };
    this.slider.value = this.index;
    this.slider.setAttribute("aria-valuetext", `${words}, ${kind}`);
    this.label.replaceChildren(
      make("strong", {}, words),
      this.edited
        ? make("button", back, "Back to the recorded episode")
        : make("span", { class: `tag ${this.episode.kind}` }, kind)
    );
  }

  showPlaying() {
    const label = this.timer ? "Pause" : "Play";
    this.player.setAttribute("aria-label", label);
    this.player.title = label;
    this.player.replaceChildren(icon(label.toLowerCase()));
  }

  ending() {
    const reached = this.frames[this.frames.length - 1].success ? "Goal reached" : "Goal not reached";
    const best = this.edited || this.episode.optimal === null ? "" : ` The planner needs ${this.episode.optimal}.`;
    return `${reached} in ${counted(this.frames.length - 1, "step")}.${best}`;
  }

  show() {
    const frame = this.frames[this.t];
    this.scrubber.value = this.t;
    this.scrubber.setAttribute("aria-valuetext", `step ${this.t} of ${this.frames.length - 1}`);
    this.status.textContent = this.words(frame);
    this.drawBoard(frame);
    this.tree.update(frame);
    this.reasons.update(frame, frame.final ? this.ending() : "");
    this.charts.update(this.t);
    this.inputs.update(frame);
  }

  // The step in one sentence.
  words(frame) {
    if (this.question) return `Step ${this.t}: ${actionWords(this.program, frame.action)}`;
    const step = `Step ${this.t} of ${this.frames.length - 1}`;
    if (frame.final) return `${step}: ${this.ending()}`;
    const illegal = frame.legal === false ? " (not possible: nothing moves)" : "";
    return `${step}: ${actionWords(this.program, frame.action)}, reward ${signed(frame.reward)}${illegal}`;
  }

  drawBoard(frame) {
    if (this.question) {
      this.question.update(frame);
      return;
    }
    const kept = document.activeElement?.getAttribute("data-key");
    const world = BOARDS[this.data.world];
    if (this.scene) this.place.board.replaceChildren(drawScene(this.scene, frame.index));
    else if (world) this.place.board.replaceChildren(world.draw(frame, this, this.frames.slice(0, this.t)));
    if (kept) this.place.board.querySelector(`[data-key="${kept}"]`)?.focus();
  }

  // What a board calls when a thing is picked up or put back.
  select(thing) {
    this.stop();
    this.selected = thing;
    this.show();
  }
}

// A number that an address asks for; what is not one from 0 on is as if it were not there.
function wholeNumber(text, otherwise) {
  return /^\d+$/.test(text ?? "") ? Number(text) : otherwise;
}

// {n_discs: 3, layout: "comb"} as "3 discs, comb".
function variationWords(variation, size) {
  return Object.entries(variation)
    .map(([name, value]) => {
      if (name !== size) return String(value).split("\n").length > 1 ? `own ${name}` : String(value);
      const noun = name.replace(/^n_/, "").replace(/_/g, " ");
      return `${value} ${value === 1 ? noun.replace(/s$/, "") : noun}`;
    })
    .join(", ");
}

if (typeof document !== "undefined") window.page = new Page(JSON.parse(document.getElementById("data").textContent));
