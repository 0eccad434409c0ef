// Bags: told by their names, and looked into before they are uploaded: pieces of them are sent, and the server's reader says what else it needs.

import { Problem, request } from "./api";
import { pause } from "./events";
import type { Inspection, JobError } from "./types";
import type { Item } from "./upload";

export const BAG = /\.(bag|mcap|db3)(\.active|\.zstd?)?$/i;
const MB = 1024 * 1024;
const FIRST = 40 * MB;
const LAST = 8 * MB;
const MOST_FIRST = 6 * MB;
const MOST_LAST = 2 * MB;
const MOST = 60 * MB;
const WHOLE = MB;
const ROUNDS = 12;

export interface Look {
  inspection: Inspection | null;
  /** Why nothing is known yet; empty: all is. */
  later: string;
  error: JobError | null;
}

interface Answer extends Look {
  needs: { path: string; begin: number; end: number }[];
}

type Pieces = Map<string, [number, number][]>;

export function isBag(items: Item[]): boolean {
  return items.some((item) => BAG.test(item.path));
}

/** What is in a bag, by its begin and end and what the server asks for beside them. */
export async function inspectBag(items: Item[], name: string, signal: AbortSignal): Promise<Look> {
  const pieces = beginAndEnd(items);
  const later = "What is in it is shown when all of it has arrived.";
  for (let round = 0; round < ROUNDS && bytesOf(pieces) <= MOST; round++) {
    const answer = await ask(items, pieces, name, signal);
    if (answer === null) break;
    if (answer.needs.length === 0) return answer;
    for (const { path, begin, end } of answer.needs) pieces.get(path)?.push([begin, end]);
  }
  return { inspection: null, later, error: null };
}

function beginAndEnd(items: Item[]): Pieces {
  const bags = items.filter((item) => BAG.test(item.path)).length;
  const first = Math.min(MOST_FIRST, Math.floor(FIRST / bags));
  const last = Math.min(MOST_LAST, Math.floor(LAST / bags));
  return new Map(items.map(({ path, file: { size } }): [string, [number, number][]] => {
    if (!BAG.test(path)) return [path, size <= WHOLE ? [[0, size]] : []];
    return [path, size <= first + last ? [[0, size]] : [[0, first], [size - last, size]]];
  }));
}

function bytesOf(pieces: Pieces): number {
  return [...pieces.values()].flat().reduce((sum, [begin, end]) => sum + end - begin, 0);
}

/** Null: it cannot be asked now, and is found out after the upload. */
async function ask(items: Item[], pieces: Pieces, name: string, signal: AbortSignal): Promise<Answer | null> {
  const files = items.map(({ path, file }) => ({ path, size: file.size, pieces: pieces.get(path) ?? [] }));
  const slices = items.flatMap(({ path, file }) => (pieces.get(path) ?? []).map(([begin, end]) => file.slice(begin, end)));
  const body = new Blob([`${JSON.stringify({ files })}\n`, ...slices]);
  const headers = { "Content-Type": "application/octet-stream" };
  for (let tries = 0; tries < 5; tries++) {
    try {
      const response = await request(`/v1/inspections?name=${encodeURIComponent(name)}`, { method: "POST", body, headers, signal });
      return (await response.json()) as Answer;
    } catch (error) {
      if (signal.aborted || (error instanceof Problem && error.status === 401)) throw error;
      if (!(error instanceof Problem) || error.code !== "unavailable") return null;
      await pause((error.retryAfter ?? 2) * 1000, signal);
    }
  }
  return null;
}
