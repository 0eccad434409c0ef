// Small pieces that all views share.

import type { ComponentChildren } from "preact";

import { percent } from "../format";
import type { JobState, StageState } from "../types";

const STATE_WORDS: Record<string, string> = {
  queued: "queued", running: "running", canceling: "canceling", done: "done", failed: "failed", canceled: "canceled",
  uploading: "uploading", validating: "checking", ready: "ready", invalid: "invalid", waiting: "waiting", stopped: "stopped",
};

/** A state as a colored word; the color is never all that tells it. */
export function Badge({ state }: { state: JobState | StageState | string }) {
  return (
    <span class={`badge badge-${state}`}>
      <span class="dot" aria-hidden="true" />
      {STATE_WORDS[state] ?? state}
    </span>
  );
}

export function Bar({ fraction, label, state = "running" }: { fraction: number | null; label: string; state?: string }) {
  const known = fraction !== null;
  const part = known ? Math.max(0, Math.min(1, fraction)) : 0;
  return (
    <div
      class={`bar bar-${state}${known ? "" : " bar-unknown"}`}
      role="progressbar"
      aria-label={label}
      aria-valuemin={0}
      aria-valuemax={100}
      {...(known ? { "aria-valuenow": Math.round(part * 100), "aria-valuetext": percent(part) } : {})}
    >
      <div class="bar-fill" style={{ width: `${String(part * 100)}%` }} />
    </div>
  );
}

export function Trouble({ trouble, children }: { trouble: { cause: string; hint: string } | null; children?: ComponentChildren }) {
  if (trouble === null) return null;
  return (
    <div class="trouble" role="alert">
      <strong>{trouble.cause}</strong>
      {trouble.hint !== "" && <span> {trouble.hint}</span>}
      {children}
    </div>
  );
}

export function Empty({ title, children }: { title: string; children?: ComponentChildren }) {
  return (
    <div class="empty">
      <p class="empty-title">{title}</p>
      {children}
    </div>
  );
}

export function Card({ title, children, aside, id }: { title: string; children: ComponentChildren; aside?: ComponentChildren; id: string }) {
  return (
    <section class="card" aria-labelledby={id}>
      <header class="card-head">
        <h2 id={id}>{title}</h2>
        {aside}
      </header>
      {children}
    </section>
  );
}

export function Facts({ rows }: { rows: [string, ComponentChildren][] }) {
  return (
    <dl class="facts">
      {rows.map(([name, value]) => (
        <div key={name}>
          <dt>{name}</dt>
          <dd>{value}</dd>
        </div>
      ))}
    </dl>
  );
}

/** One of several, as buttons side by side. */
export function Segments<T extends string>(props: { label: string; value: T; options: [T, string][]; choose: (value: T) => void }) {
  return (
    <div class="segments" role="group" aria-label={props.label}>
      {props.options.map(([value, word]) => (
        <button key={value} type="button" aria-pressed={value === props.value} onClick={() => { props.choose(value); }}>
          {word}
        </button>
      ))}
    </div>
  );
}
